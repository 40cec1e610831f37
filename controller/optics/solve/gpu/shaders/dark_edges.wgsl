// Edges (eq. 3) beside dark pixels count nothing, as in bounded/gradient.py; the majoriser holds the data's part.
@group(0) @binding(1) var<storage, read> majoriser: array<f32>;
@group(0) @binding(2) var<storage, read_write> edge_weights: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  let row = at / frame.columns;
  let column = at % frame.columns;
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * frame.pixels;
    var kept = 0u;
    if (majoriser[i] > 0.0) {
      if (column + 1u < frame.columns) { kept |= select(0u, 0xffffu, majoriser[i + 1u] > 0.0); }
      if (row + 1u < frame.rows) { kept |= select(0u, 0xffff0000u, majoriser[i + frame.columns] > 0.0); }
    }
    edge_weights[i] &= kept;
  }
}
