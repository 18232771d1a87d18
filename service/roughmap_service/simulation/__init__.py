"""A simulated rover, and the playing of recorded scans."""
