// Adds what larger windows see of the mixed frame to their sites.
@group(0) @binding(5) var<storage, read> shown: array<f32>;
@group(0) @binding(6) var<storage, read_write> sensor: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
  let place = band.own_row + id.y;
  let e = first[place * u32(band.place_columns)] + id.x;
  if (e >= first[(place + 1u) * u32(band.place_columns)]) { return; }
  let w = records[e];
  let top = i32(place) + band.place_row;
  let plane = i32(colour_of(w) * band.pixels);
  let wide = wide_of(w);
  let high = high_of(w);
  var total = 0.0;
  for (var j = max(0, -top); j < min(high.y, band.rows - top); j++) {
    let x = moved(w, high.y, j);
    let left = left_of(w) + (x >> PHASE_BITS);
    let shares = wide.x + (x & (PHASES - 1)) * wide.y;
    let row = plane + (top + j) * band.columns + left;
    var part = 0.0;
    for (var i = max(0, -left); i < min(wide.y, band.columns - left); i++) {
      part += table[shares + i] * shown[row + i];
    }
    total += part * row_share(w, high, j);
  }
  sensor[w.x] += bitcast<f32>(w.y) * total;
}
