// What a solve carries from sweep to sweep; see bounded/engine.py for their order there.
struct State {
  inertia: f32,
  momentum: f32,
  overrelaxation: f32,
  least: f32,
  kkt: f32,
  // 0 while sweeping, 1 in the sweep that met the tolerance, 2 after it
  over: f32,
  sweeps: f32,
  total: f32,
  tolerance: f32,
  most_growth: f32,
  most_overrelaxation: f32,
}
