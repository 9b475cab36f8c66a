"""What a study shows: conclusions, tables, figures, the page."""
