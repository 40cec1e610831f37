// Ends a sweep: its KKT residual, and the momentum that follows from it.
@group(0) @binding(0) var<storage, read> partials: array<vec2<f32>>;
@group(0) @binding(1) var<storage, read_write> state: State;

var<workgroup> sums: array<vec2<f32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
  var own = vec2<f32>(0.0);
  for (var i = lane; i < arrayLength(&partials); i += 256u) { own += partials[i]; }
  sums[lane] = own;
  for (var half = 128u; half > 0u; half /= 2u) {
    workgroupBarrier();
    if (lane < half) { sums[lane] += sums[lane + half]; }
  }
  if (lane != 0u) { return; }
  if (state.over > 0.0) {
    state.over = 2.0;
    return;
  }
  state.kkt = sqrt(sums[0].x / state.total);
  let next = (1.0 + sqrt(1.0 + 4.0 * state.inertia * state.inertia)) / 2.0;
  state.momentum = (state.inertia - 1.0) / next;
  state.overrelaxation = state.most_overrelaxation * state.inertia / next;
  state.inertia = next;
  state.least = min(state.least, state.kkt);
  if (sums[0].y > 0.0 || state.kkt > state.most_growth * state.least) {
    state.momentum = 0.0;
    state.overrelaxation = 0.0;
    state.inertia = 1.0;
  }
  state.sweeps += 1.0;
  if (state.kkt <= state.tolerance) { state.over = 1.0; }
}
