// Adds up what each pixel gives, group by group: ``of_pixel``, of the file before.
@group(0) @binding(7) var<storage, read_write> sums: array<vec2<f32>>;

@compute @workgroup_size(64)
fn main(
  @builtin(global_invocation_id) id: vec3<u32>,
  @builtin(num_workgroups) groups: vec3<u32>,
  @builtin(workgroup_id) group: vec3<u32>,
  @builtin(local_invocation_index) lane: u32,
) {
  let at = index_of(id, groups);
  var own = 0.0;
  if (at < frame.pixels) { own = of_pixel(at); }
  let all = add_up(vec2<f32>(own, 0.0), lane);
  if (lane == 0u) { sums[group.x + group.y * groups.x] = all; }
}
