"""What can be reached of a target: `exposure`, `feasibility`, `drive_levels`; `adaptation` where light is lacking."""
