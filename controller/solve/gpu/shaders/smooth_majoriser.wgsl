// Adds twice the weights of a pixel's edges to the majoriser, dark pixels too, and adds all of it up.
@group(0) @binding(1) var<storage, read_write> majoriser: array<f32>;
@group(0) @binding(2) var<storage, read> edge_weights: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec2<f32>>;

@compute @workgroup_size(64)
fn main(
  @builtin(global_invocation_id) id: vec3<u32>,
  @builtin(num_workgroups) groups: vec3<u32>,
  @builtin(workgroup_id) group: vec3<u32>,
  @builtin(local_invocation_index) lane: u32,
) {
  let at = index_of(id, groups);
  var own = 0.0;
  if (at < frame.pixels) {
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
  }
  let all = add_up(vec2<f32>(own, 0.0), lane);
  if (lane == 0u) { sums[group.x + group.y * groups.x] = all; }
}
