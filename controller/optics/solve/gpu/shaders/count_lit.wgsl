// Counts a projector's numbers that light anything.
@group(0) @binding(1) var<storage, read> majoriser: array<f32>;

fn of_pixel(at: u32) -> f32 {
  var own = 0.0;
  for (var c = 0u; c < 3u; c++) { own += select(0.0, 1.0, majoriser[at + c * frame.pixels] > 0.0); }
  return own;
}
