// Writes T' r: each projector pixel gathers from the small windows that cover it.
@group(0) @binding(6) var<storage, read_write> result: array<f32>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
  let x = i32(id.x);
  let y = band.first_row + i32(id.y);
  if (x >= band.columns || y >= band.end_row) { return; }
  var sums = vec3<f32>(0.0);
  for (var top = max(y - 3, band.place_row); top <= y; top++) {
    let row = (top - band.place_row) * band.place_columns + x + MARGIN;
    let end = first[row + 1];
    for (var e = first[row - 3]; e < end; e++) {
      let w = shape_of(e);
      sums += coloured(w, share(w, x - left_of(w), y - top) * weighed[e]);
    }
  }
  let at = u32(y * band.columns + x);
  let found = sums.x * band.mixing[0] + sums.y * band.mixing[1] + sums.z * band.mixing[2];
  result[at] = found.x;
  result[at + band.pixels] = found.y;
  result[at + 2u * band.pixels] = found.z;
}
