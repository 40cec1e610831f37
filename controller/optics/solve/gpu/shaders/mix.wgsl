// Writes a frame in the camera's channels, M p.
@group(0) @binding(1) var<storage, read> p: array<f32>;
@group(0) @binding(2) var<storage, read_write> shown: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  let light = applied(vec3<f32>(p[at], p[at + frame.pixels], p[at + 2u * frame.pixels]));
  for (var c = 0u; c < 3u; c++) { shown[at + c * frame.pixels] = light[c]; }
}
