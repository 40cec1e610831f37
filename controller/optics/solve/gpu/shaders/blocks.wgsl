// What the kernels over blocks of camera pixels share.
struct Blocks {
  columns: u32,
  rows: u32,
  pixels: u32,
  // blocks side by side, and one above the other
  across: u32,
  down: u32,
  projectors: u32,
  // the projector that is meant
  number: u32,
}

@group(0) @binding(0) var<uniform> blocks: Blocks;

fn index_of(id: vec3<u32>, groups: vec3<u32>) -> u32 { return id.x + id.y * groups.x * 64u; }
