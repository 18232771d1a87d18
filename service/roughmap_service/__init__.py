"""The long-running map service and its command line."""
