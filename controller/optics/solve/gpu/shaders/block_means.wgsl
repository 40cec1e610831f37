// Writes means of a picture over blocks, to the place of one projector.
@group(0) @binding(1) var<storage, read> picture: array<f32>;
@group(0) @binding(2) var<storage, read_write> means: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  let count = blocks.across * blocks.down;
  if (at >= count) { return; }
  let top = BLOCK_PX * (at / blocks.across);
  let left = BLOCK_PX * (at % blocks.across);
  var sums = vec3<f32>(0.0);
  var pixels = 0.0;
  for (var y = top; y < min(top + BLOCK_PX, blocks.rows); y++) {
    for (var x = left; x < min(left + BLOCK_PX, blocks.columns); x++) {
      let i = y * blocks.columns + x;
      sums += vec3<f32>(picture[i], picture[i + blocks.pixels], picture[i + 2u * blocks.pixels]);
      pixels += 1.0;
    }
  }
  for (var c = 0u; c < 3u; c++) { means[(3u * blocks.number + c) * count + at] = sums[c] / pixels; }
}
