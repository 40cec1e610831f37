"""The pages: `routes` serves them, `drawing` renders templates, `forms` handles their forms."""
