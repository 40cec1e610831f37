// Adds up the smoothness term of the objective over a projector's pixels.
@group(0) @binding(1) var<storage, read> x: array<f32>;
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
  }
  let all = add_up(vec2<f32>(own, 0.0), lane);
  if (lane == 0u) { sums[group.x + group.y * groups.x] = all; }
}
