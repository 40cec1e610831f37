// Writes the light to be made: what a picture has above black. Both are by pixel; planes come out.
@group(0) @binding(1) var<storage, read> picture: array<f32>;
@group(0) @binding(2) var<storage, read> black: array<f32>;
@group(0) @binding(3) var<storage, read_write> wanted: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  for (var c = 0u; c < 3u; c++) {
    wanted[at + c * frame.pixels] = max(picture[3u * at + c] - black[3u * at + c], 0.0);
  }
}
