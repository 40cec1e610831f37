// Adds up w s^2 over the camera's pixels, from w s.
@group(0) @binding(1) var<storage, read> counted: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
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
  if (at < frame.pixels && weights[at] > 0.0) {
    for (var c = 0u; c < 3u; c++) {
      let light = counted[at + c * frame.pixels];
      own += light * light / weights[at];
    }
  }
  let all = add_up(vec2<f32>(own, 0.0), lane);
  if (lane == 0u) { sums[group.x + group.y * groups.x] = all; }
}
