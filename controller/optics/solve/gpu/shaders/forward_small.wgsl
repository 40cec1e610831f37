// Adds what small windows see of the mixed frame to their sites: T p, one window a thread, each row of places by itself.
@group(0) @binding(5) var<storage, read> shown: array<f32>;
@group(0) @binding(6) var<storage, read_write> sensor: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
  let place = band.own_row + id.y;
  let e = first[place * u32(band.place_columns)] + id.x;
  if (e >= first[(place + 1u) * u32(band.place_columns)]) { return; }
  let w = records[e];
  let top = i32(place) + band.place_row;
  let left = left_of(w);
  let plane = colour_of(w) * band.pixels;
  var total = 0.0;
  for (var j = max(0, -top); j < min(4, band.rows - top); j++) {
    let row = i32(plane) + (top + j) * band.columns + left;
    for (var i = max(0, -left); i < min(4, band.columns - left); i++) {
      total += share(w, i, j) * shown[row + i];
    }
  }
  sensor[w.x] += bitcast<f32>(w.y) * total;
}
