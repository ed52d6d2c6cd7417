"""The report: tables, plots, pictures and videos of a finished evaluation, in one HTML file."""
