"""What an object will look like, before anything is computed: `reach` is quick, `computed` solves the whole target,
in a process of its own (`computing`). `scenes` renders first.
"""
