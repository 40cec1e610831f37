// Adds a term's light to its camera pixels, which follow the sites in the sensor's buffer.
@group(0) @binding(5) var<storage, read> slots: array<u32>;
@group(0) @binding(6) var<storage, read> shown: array<f32>;
@group(0) @binding(7) var<storage, read_write> sensor: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let row = index_of(id, groups);
  if (row >= term.rows) { return; }
  var sums = vec3<f32>(0.0);
  for (var k = first[row]; k < first[row + 1u]; k++) {
    let at = members[k];
    sums += differences[k] * vec3<f32>(shown[at], shown[at + term.pixels], shown[at + 2u * term.pixels]);
  }
  for (var c = 0u; c < 3u; c++) {
    sensor[term.sites + c * term.edges + slots[row]] += white[c * term.rows + row] * sums[c];
  }
}
