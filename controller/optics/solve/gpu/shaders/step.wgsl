// A projected, scaled gradient step of one projector, with smoothness, bounds and white segment (eqs 2 and 3).
@group(0) @binding(1) var<storage, read> y: array<f32>;
@group(0) @binding(2) var<storage, read> x: array<f32>;
@group(0) @binding(3) var<storage, read> majoriser: array<f32>;
// squared weights of smoothness in steps of frame.strength_per_step: to the right neighbour (low half), and to the one below
@group(0) @binding(4) var<storage, read> edge_weights: array<u32>;
// the gradient before, the step after
@group(0) @binding(5) var<storage, read_write> step: array<f32>;
@group(0) @binding(6) var<storage, read_write> shown: array<f32>;
@group(0) @binding(7) var<storage, read_write> partials: array<vec2<f32>>;
@group(0) @binding(8) var<storage, read> state: State;

fn smooth_gradient(c: u32, at: u32, row: u32, column: u32) -> f32 {
  let i = c * frame.pixels + at;
  let here = y[i];
  var total = 0.0;
  if (column + 1u < frame.columns) { total += f32(edge_weights[i] & 0xffffu) * (here - y[i + 1u]); }
  if (column > 0u) { total += f32(edge_weights[i - 1u] & 0xffffu) * (here - y[i - 1u]); }
  if (row + 1u < frame.rows) { total += f32(edge_weights[i] >> 16u) * (here - y[i + frame.columns]); }
  if (row > 0u) { total += f32(edge_weights[i - frame.columns] >> 16u) * (here - y[i - frame.columns]); }
  return frame.strength_per_step * total;
}

// The nearest colour to p that a projector with a white segment can show, by majoriser d; as in bounded/gradient.py.
fn within_segment(p: vec3<f32>, d: vec3<f32>) -> vec3<f32> {
  let s = frame.segment;
  var least = 0u;
  for (var c = 1u; c < 3u; c++) { if (p[c] < p[least]) { least = c; } }
  let one = (least + 1u) % 3u;
  let other = (least + 2u) % 3u;
  let first = select(other, one, p[one] >= p[other]);
  let second = select(one, other, p[one] >= p[other]);
  var top = 1.0 - s + s * p[least];
  if (p[first] <= top) { return p; }
  let own = max(d[least], 1e-30);
  var rise = s * d[first] * (p[first] - top) / (own + s * s * d[first]);
  if (p[second] > top + s * rise) {
    let pull = s * (d[first] * (p[first] - top) + d[second] * (p[second] - top));
    rise = pull / (own + s * s * (d[first] + d[second]));
  }
  if (p[least] <= 0.0) { rise = 0.0; }
  var darkest = p[least] + rise;
  var between = p[second];
  if (darkest > between) {
    let pull = own * p[least] + d[second] * between + s * d[first] * (p[first] - (1.0 - s));
    darkest = max(pull / (own + d[second] + s * s * d[first]), between);
    between = darkest;
  }
  top = 1.0 - s + s * darkest;
  var found = p;
  found[least] = darkest;
  found[first] = min(p[first], top);
  found[second] = min(between, top);
  return found;
}

@compute @workgroup_size(64)
fn main(
  @builtin(global_invocation_id) id: vec3<u32>,
  @builtin(num_workgroups) groups: vec3<u32>,
  @builtin(workgroup_id) group: vec3<u32>,
  @builtin(local_invocation_index) lane: u32,
) {
  let at = index_of(id, groups);
  var own = vec2<f32>(0.0);
  if (at < frame.pixels) {
    let row = at / frame.columns;
    let column = at % frame.columns;
    var d = vec3<f32>(0.0);
    var was = vec3<f32>(0.0);
    var last = vec3<f32>(0.0);
    var to = vec3<f32>(0.0);
    for (var c = 0u; c < 3u; c++) {
      let i = c * frame.pixels + at;
      d[c] = majoriser[i];
      was[c] = y[i];
      last[c] = x[i];
      let gradient = step[i] + smooth_gradient(c, at, row, column);
      to[c] = select(0.0, clamp(was[c] - gradient / max(d[c], 1e-30), 0.0, 1.0), d[c] > 0.0);
    }
    if (frame.segment > 0.0) { to = within_segment(to, d); }
    let moved = select(to - was, vec3<f32>(0.0), state.over > 0.0);
    own = vec2<f32>(dot(d, moved * moved), dot(d, (was - to) * (to - last)));
    let light = applied(moved);
    for (var c = 0u; c < 3u; c++) {
      step[c * frame.pixels + at] = moved[c];
      shown[c * frame.pixels + at] = light[c];
    }
  }
  let all = add_up(own, lane);
  if (lane == 0u) { partials[frame.partials + group.x + group.y * groups.x] = all; }
}
