"""What became of a target: `metrics`, `evaluation` and `ghosting` of a photographed result, and its `refinement`."""
