"""Results and progress as text, files and reports."""
