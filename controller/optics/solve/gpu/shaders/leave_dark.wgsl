// Pixels that light only what is beside the object get no data.
@group(0) @binding(1) var<storage, read_write> majoriser: array<f32>;
@group(0) @binding(2) var<storage, read> beside: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels || beside[at] == 0.0) { return; }
  for (var c = 0u; c < 3u; c++) { majoriser[at + c * frame.pixels] = 0.0; }
}
