// Writes white in the camera's channels, M 1.
@group(0) @binding(1) var<storage, read_write> shown: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  let light = applied(vec3<f32>(1.0));
  for (var c = 0u; c < 3u; c++) { shown[at + c * frame.pixels] = light[c]; }
}
