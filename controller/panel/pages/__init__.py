"""The pages: `routes` answers them, `drawing` fills templates, `forms` carries out what they post."""
