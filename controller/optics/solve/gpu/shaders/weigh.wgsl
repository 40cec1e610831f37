// Writes the light of each window's site times its gain: read once here, and by many pixels afterwards.
@group(0) @binding(5) var<storage, read> values: array<f32>;
@group(0) @binding(6) var<storage, read_write> weighed: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let e = id.x + id.y * groups.x * 64u;
  if (e >= arrayLength(&records)) { return; }
  let w = records[e];
  weighed[e] = gain_of(e, w) * values[w.x];
}
