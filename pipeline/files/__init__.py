"""Files of plain tables and JSON."""
