"""A file a format, in and out: point clouds, recorded scans, pictures."""
