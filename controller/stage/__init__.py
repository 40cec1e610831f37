"""A stage on disk: it is checked (`check.check_stage`), its devices are opened (`open.opened`), and a run is
made on it by who has its lock and devices (`session.StageSession`).
"""
