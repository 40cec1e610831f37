"""What everything rests on: errors with codes, files written atomically, arrays, compiled kernels, text,
plotting. Start with `errors.VelaturaError` and `storage.write_atomically`.
"""
