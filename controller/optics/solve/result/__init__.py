"""What became of a target: `metrics` and `ghosting` of a photographed result, and its `refinement`."""
