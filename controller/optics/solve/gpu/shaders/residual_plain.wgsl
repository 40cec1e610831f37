// Writes weights (s - target): each pixel has three sites.
@group(0) @binding(1) var<storage, read> sensor: array<f32>;
@group(0) @binding(4) var<storage, read_write> residual: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= camera.pixels) { return; }
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * camera.pixels;
    residual[i] = weight_at(at) * (sensor[i] - wanted_at(i));
  }
}
