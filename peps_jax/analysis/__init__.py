"""Statistics, the planner that knows the models, and maps of what was learned."""
