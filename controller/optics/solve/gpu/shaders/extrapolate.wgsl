// Takes a projector's step: the new point to x, and the extrapolated one to y.
@group(0) @binding(1) var<storage, read_write> y: array<f32>;
@group(0) @binding(2) var<storage, read_write> x: array<f32>;
@group(0) @binding(3) var<storage, read> step: array<f32>;
@group(0) @binding(4) var<storage, read> state: State;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels || state.over > 1.0) { return; }
  for (var i = at; i < 3u * frame.pixels; i += frame.pixels) {
    let found = clamp(y[i] + step[i], 0.0, 1.0);
    y[i] = found + state.momentum * (found - x[i]) + state.overrelaxation * step[i];
    x[i] = found;
  }
}
