"""Where to put projectors, before there is anything to measure: predicted resolution, light and focus on a mesh."""
