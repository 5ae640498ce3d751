"""Files that are whole or absent, checksums, and tables."""
