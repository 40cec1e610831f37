// Writes weights (D s - target): D makes a picture of a colour camera's sites.
@group(0) @binding(1) var<storage, read> sensor: array<f32>;
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
@group(0) @binding(3) var<storage, read> weights: array<f32>;
@group(0) @binding(4) var<storage, read_write> residual: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= camera.pixels) { return; }
  let weight = weights[at];
  var picture = vec3<f32>(0.0);
  if (weight > 0.0) {
    let y = i32(at) / camera.columns;
    let x = i32(at) % camera.columns;
    var count = vec3<f32>(0.0);
    for (var r = max(y - 1, 0); r < min(y + 2, camera.rows); r++) {
      for (var c = max(x - 1, 0); c < min(x + 2, camera.columns); c++) {
        let colour = colour_at(r, c);
        picture[colour] += sensor[r * camera.columns + c];
        count[colour] += 1.0;
      }
    }
    picture /= max(count, vec3<f32>(1.0));
    picture[colour_at(y, x)] = sensor[at];
  }
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * camera.pixels;
    residual[i] = weight * (picture[c] - wanted[i]);
  }
}
