"""Queries and updates: planned, read from a frozen map, drawn and sent."""
