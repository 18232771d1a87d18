"""`roughmap demo`: service, rover, planner and replay on this machine."""

from roughmap_service.cli.demo.command import demo

__all__ = ["demo"]
