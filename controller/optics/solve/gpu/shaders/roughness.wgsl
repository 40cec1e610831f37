// Adds up the smoothness term of the objective over a projector's pixels (eq. 3).
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> edge_weights: array<u32>;

fn of_pixel(at: u32) -> f32 {
  var own = 0.0;
  let row = at / frame.columns;
  let column = at % frame.columns;
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * frame.pixels;
    var part = 0.0;
    if (column + 1u < frame.columns) {
      let apart = x[i + 1u] - x[i];
      part += f32(edge_weights[i] & 0xffffu) * apart * apart;
    }
    if (row + 1u < frame.rows) {
      let apart = x[i + frame.columns] - x[i];
      part += f32(edge_weights[i] >> 16u) * apart * apart;
    }
    own += frame.strength_per_step * part;
  }
  return own;
}
