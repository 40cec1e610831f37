// Base times scale of one projector, in the camera's channels and back; frame.matrix unmixes (eqs 4 to 6).
// sums under the metapixels before, frames after
@group(0) @binding(1) var<storage, read_write> sums: array<f32>;
// the base's mixed frames times what makes means of the sums
@group(0) @binding(2) var<storage, read> base: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  var light = vec3<f32>(0.0);
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * frame.pixels;
    light[c] = sums[i] * base[i];
  }
  let p = clamp(applied(light), vec3<f32>(0.0), vec3<f32>(1.0));
  let top = 1.0 - frame.segment * (1.0 - min(p.x, min(p.y, p.z)));
  for (var c = 0u; c < 3u; c++) { sums[at + c * frame.pixels] = min(p[c], top); }
}
