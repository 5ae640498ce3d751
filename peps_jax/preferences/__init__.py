"""Queries, who answers them, and the answers."""
