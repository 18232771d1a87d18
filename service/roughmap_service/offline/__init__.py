"""Work on a recorded run without a service: replay and what-if."""
