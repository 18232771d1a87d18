"""A simulated rover, and recorded scans played to a service.

rover.py        a rover's messages, its true poses known
world.py        where it drives: ground.py, and solids.py on it; scanner.py sees them
truth.py        what a perfect map would say of that world
playing.py      recorded scans as messages
publishing.py   publishes messages at the pace at which they were made
"""
