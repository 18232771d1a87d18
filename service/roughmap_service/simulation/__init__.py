"""A simulated rover, and the publishing of recorded scans."""
