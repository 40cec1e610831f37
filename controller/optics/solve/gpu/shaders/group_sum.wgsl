// Adds up what the threads of a group have, in one order; all of them must call it.
var<workgroup> group_sums: array<vec2<f32>, 64>;

fn add_up(own: vec2<f32>, lane: u32) -> vec2<f32> {
  group_sums[lane] = own;
  for (var half = 32u; half > 0u; half /= 2u) {
    workgroupBarrier();
    if (lane < half) { group_sums[lane] += group_sums[lane + half]; }
  }
  return group_sums[0];
}
