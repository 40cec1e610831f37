// Lets the light of the sensor follow: of the new point to last, of the extrapolated one to light.
@group(0) @binding(0) var<storage, read_write> light: array<f32>;
@group(0) @binding(1) var<storage, read_write> last: array<f32>;
@group(0) @binding(2) var<storage, read> before: array<f32>;
@group(0) @binding(3) var<storage, read> state: State;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = id.x + id.y * groups.x * 64u;
  if (at >= arrayLength(&light) || state.over > 1.0) { return; }
  let found = light[at];
  light[at] = found + state.momentum * (found - last[at]) + state.overrelaxation * (found - before[at]);
  last[at] = found;
}
