"""A complete job on an emulated stage, with a report at the end. Entry: `job.demo`, `stage`."""
