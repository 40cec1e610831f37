// Adds up w s^2 over the camera's pixels, from w s.
@group(0) @binding(1) var<storage, read> counted: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;

fn of_pixel(at: u32) -> f32 {
  if (weights[at] <= 0.0) { return 0.0; }
  var own = 0.0;
  for (var c = 0u; c < 3u; c++) {
    let light = counted[at + c * frame.pixels];
    own += light * light / weights[at];
  }
  return own;
}
