// Writes the squared weights of smoothness to the right (low half) and lower neighbour, as in bounded/equations.py (eq. 3).
@group(0) @binding(1) var<storage, read> sums: array<f32>;
@group(0) @binding(2) var<storage, read> per_sum: array<f32>;
@group(0) @binding(3) var<storage, read> observed: array<f32>;
@group(0) @binding(4) var<storage, read_write> edge_weights: array<u32>;

fn alike(i: u32, j: u32) -> u32 {
  if (observed[i] <= frame.faint || observed[j] <= frame.faint) { return 0u; }
  let one = sums[i] * per_sum[i] / observed[i];
  let other = sums[j] * per_sum[j] / observed[j];
  let larger = max(one, other);
  let alpha = select(1.0, min(one, other) / larger, larger > 0.0);
  return u32(EDGE_WEIGHT_STEPS * alpha * alpha + 0.5);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  let row = at / frame.columns;
  let column = at % frame.columns;
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * frame.pixels;
    var found = 0u;
    if (column + 1u < frame.columns) { found = alike(i, i + 1u); }
    if (row + 1u < frame.rows) { found |= alike(i, i + frame.columns) << 16u; }
    edge_weights[i] = found;
  }
}
