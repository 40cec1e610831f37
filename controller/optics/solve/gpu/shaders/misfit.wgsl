// Adds up w (picture - wanted)^2 over the camera's pixels (eq. 2).
@group(0) @binding(1) var<storage, read> picture: array<f32>;
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
@group(0) @binding(3) var<storage, read> weights: array<f32>;

fn of_pixel(at: u32) -> f32 {
  var own = 0.0;
  for (var c = 0u; c < 3u; c++) {
    let missed = picture[at + c * frame.pixels] - wanted[at + c * frame.pixels];
    own += weights[at] * missed * missed;
  }
  return own;
}
