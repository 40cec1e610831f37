"""What can be reached of a target, and its exposure: `feasibility`, `drive_levels`; `adaptation` bends the rest."""
