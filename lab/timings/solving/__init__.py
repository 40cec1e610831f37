"""The light transport and the solves with it: time, memory, cores, graphics processors."""
