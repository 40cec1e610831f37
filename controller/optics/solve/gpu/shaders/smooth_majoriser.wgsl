// Adds twice the weights of a pixel's edges (eq. 3) to the majoriser, dark pixels too, and adds all of it up.
@group(0) @binding(1) var<storage, read_write> majoriser: array<f32>;
@group(0) @binding(2) var<storage, read> edge_weights: array<u32>;

fn of_pixel(at: u32) -> f32 {
  var own = 0.0;
  let row = at / frame.columns;
  let column = at % frame.columns;
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * frame.pixels;
    var edges = (edge_weights[i] & 0xffffu) + (edge_weights[i] >> 16u);
    if (column > 0u) { edges += edge_weights[i - 1u] & 0xffffu; }
    if (row > 0u) { edges += edge_weights[i - frame.columns] >> 16u; }
    let found = majoriser[i] + 2.0 * frame.strength_per_step * f32(edges);
    majoriser[i] = found;
    own += found;
  }
  return own;
}
