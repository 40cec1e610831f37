"""Patterns, exposure brackets and RAW development: `patterns.plan_patterns`, `acquire`,
`brackets.merge_brackets`, `raw`.
"""
