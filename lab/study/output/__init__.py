"""What a study leaves: figures, tables, pages and the files they are kept in."""
