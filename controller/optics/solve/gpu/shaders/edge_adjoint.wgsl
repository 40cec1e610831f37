// Adds the transpose of a term: each projector pixel that has differences gathers from its camera pixels.
@group(0) @binding(5) var<storage, read> own: array<u32>;
@group(0) @binding(6) var<storage, read> camera: array<u32>;
@group(0) @binding(7) var<storage, read> picture: array<f32>;
@group(0) @binding(8) var<storage, read_write> result: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let k = index_of(id, groups);
  if (k >= term.columns) { return; }
  var sums = vec3<f32>(0.0);
  for (var i = first[k]; i < first[k + 1u]; i++) {
    let row = members[i];
    let at = camera[row];
    for (var c = 0u; c < 3u; c++) {
      sums[c] += differences[i] * white[c * term.rows + row] * picture[at + c * term.camera_pixels];
    }
  }
  let found = sums.x * term.mixing[0] + sums.y * term.mixing[1] + sums.z * term.mixing[2];
  for (var c = 0u; c < 3u; c++) {
    result[own[k] + c * term.pixels] += found[c];
  }
}
