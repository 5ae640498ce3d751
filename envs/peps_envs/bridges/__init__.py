"""Environments of this package for other ecosystems. Each file imports its ecosystem, and nothing else does."""
