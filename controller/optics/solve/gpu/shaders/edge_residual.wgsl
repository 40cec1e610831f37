// Adds weights times the light of the terms at depth edges to a picture's residual.
@group(0) @binding(1) var<storage, read> sensor: array<f32>;
@group(0) @binding(2) var<storage, read> pixels: array<u32>;
@group(0) @binding(4) var<storage, read_write> residual: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let k = index_of(id, groups);
  if (k >= camera.edges) { return; }
  let at = pixels[k];
  for (var c = 0u; c < 3u; c++) {
    residual[at + c * camera.pixels] += weight_at(at) * sensor[camera.sites + c * camera.edges + k];
  }
}
