// Adds to T' r what each projector pixel gathers from the larger windows that cover it.
@group(0) @binding(6) var<storage, read_write> result: array<f32>;
// how far windows may begin from the pixels of a block of 8 x 8: rows above, columns to the left, to the right
@group(0) @binding(7) var<storage, read> reach: array<u32>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
  let x = i32(id.x);
  let y = band.first_row + i32(id.y);
  if (x >= band.columns || y >= band.end_row) { return; }
  let near = reach[(y / 8) * band.blocks + x / 8];
  if (near == 0u) { return; }
  let up = i32(near & 0xffu);
  let from_left = max(x - i32((near >> 8u) & 0xffu) + MARGIN, 0);
  let to_right = min(x + i32((near >> 16u) & 0xffu) + MARGIN + 1, band.place_columns);
  var sums = vec3<f32>(0.0);
  for (var top = max(y - up, band.place_row); top <= y; top++) {
    let row = (top - band.place_row) * band.place_columns;
    let end = first[row + to_right];
    for (var e = first[row + from_left]; e < end; e++) {
      let w = shape_of(e);
      let high = high_of(w);
      let j = y - top;
      if (j >= high.y) { continue; }
      let at = moved(w, high.y, j);
      let wide = wide_of(w);
      let i = x - left_of(w) - (at >> PHASE_BITS);
      if (i < 0 || i >= wide.y) { continue; }
      let share = table[wide.x + (at & (PHASES - 1)) * wide.y + i] * row_share(w, high, j);
      sums += coloured(w, share * weighed[e]);
    }
  }
  let at = u32(y * band.columns + x);
  let found = sums.x * band.mixing[0] + sums.y * band.mixing[1] + sums.z * band.mixing[2];
  result[at] += found.x;
  result[at + band.pixels] += found.y;
  result[at + 2u * band.pixels] += found.z;
}
