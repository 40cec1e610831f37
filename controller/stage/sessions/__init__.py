"""A stage on disk: checking it (`check.check_stage`), opening its devices (`open.opened_rig`), and runs with its
lock and devices (`session.StageSession`).
"""
