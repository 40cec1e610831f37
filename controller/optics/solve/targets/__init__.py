"""What makes a target picture: files, patterns, a photograph wrapped on the object, another light.
`values.Target` is the result.
"""
