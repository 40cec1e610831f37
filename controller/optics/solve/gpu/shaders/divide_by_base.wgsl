// The scale image of a target: its light times 1 / base light (paper eq. 4), in place.
@group(0) @binding(0) var<storage, read_write> light: array<f32>;
@group(0) @binding(1) var<storage, read> inverse: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = id.x + id.y * groups.x * 64u;
  if (at < arrayLength(&light)) { light[at] *= inverse[at]; }
}
