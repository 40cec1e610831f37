"""Base of all controller packages: errors with codes, atomic files, arrays, text,
plotting. Start with `errors.VelaturaError` and `storage.write_atomically`.
"""
