"""File formats, one module each: recorded clouds in (`clouds.read_cloud`), pictures out."""
