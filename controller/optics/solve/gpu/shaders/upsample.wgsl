// Gives each camera pixel what one projector has in its block.
@group(0) @binding(1) var<storage, read> shown: array<f32>;
@group(0) @binding(2) var<storage, read_write> picture: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= blocks.pixels) { return; }
  let block = (at / blocks.columns / BLOCK_PX) * blocks.across + (at % blocks.columns) / BLOCK_PX;
  let count = blocks.across * blocks.down;
  for (var c = 0u; c < 3u; c++) {
    picture[at + c * blocks.pixels] = shown[(3u * blocks.number + c) * count + block];
  }
}
