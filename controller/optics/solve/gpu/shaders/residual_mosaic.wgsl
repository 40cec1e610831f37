// Writes weights (D s - target): D makes a picture of a colour camera's sites.
@group(0) @binding(1) var<storage, read> sensor: array<f32>;
@group(0) @binding(4) var<storage, read_write> residual: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= camera.pixels) { return; }
  let weight = weight_at(at);
  var picture = vec3<f32>(0.0);
  if (weight > 0.0) {
    let y = i32(at) / camera.columns;
    let x = i32(at) % camera.columns;
    var count = vec3<f32>(0.0);
    for (var r = max(y - 1, 0); r < min(y + 2, camera.rows); r++) {
      for (var c = max(x - 1, 0); c < min(x + 2, camera.columns); c++) {
        let own = select(vec3<f32>(0.0), vec3<f32>(1.0), vec3<u32>(colour_at(r, c)) == vec3<u32>(0u, 1u, 2u));
        picture += own * sensor[r * camera.columns + c];
        count += own;
      }
    }
    picture /= max(count, vec3<f32>(1.0));
    picture = select(picture, vec3<f32>(sensor[at]), vec3<u32>(colour_at(y, x)) == vec3<u32>(0u, 1u, 2u));
  }
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * camera.pixels;
    residual[i] = weight * (picture[c] - wanted_at(i));
  }
}
