"""roughmap."""
