"""What all emulated devices share: the truth of the stage (bench.toml), faults, servers. Start at `truth`."""
