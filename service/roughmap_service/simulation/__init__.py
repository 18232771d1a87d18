"""A simulated rover, and recorded scans played to a service.

rover.py        a rover's messages, its true poses known; ground.py and scanner.py: what it drives on and sees
playing.py      recorded scans as messages
publishing.py   publishes messages at the pace at which they were made
"""
