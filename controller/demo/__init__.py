"""The whole job on an emulated stage, ending in a report. Entry: `job.demo`, `stage`."""
