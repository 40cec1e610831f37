"""Target pictures rendered by Blender in a process of its own. Entry: `job.write_job`, `run.render`."""
