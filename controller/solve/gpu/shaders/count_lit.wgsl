// Counts a projector's numbers that light anything.
@group(0) @binding(1) var<storage, read> majoriser: array<f32>;
@group(0) @binding(2) var<storage, read_write> sums: array<vec2<f32>>;

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
    for (var c = 0u; c < 3u; c++) { own += select(0.0, 1.0, majoriser[at + c * frame.pixels] > 0.0); }
  }
  let all = add_up(vec2<f32>(own, 0.0), lane);
  if (lane == 0u) { sums[group.x + group.y * groups.x] = all; }
}
