"""A stage on disk: checking it (`check.check_stage`), opening its devices (`open.opened`), and runs with its
lock and devices (`session.StageSession`).
"""
