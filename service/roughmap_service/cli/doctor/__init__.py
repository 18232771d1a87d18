"""`roughmap doctor`: check configuration, machine, network and robots."""

from roughmap_service.cli.doctor.command import doctor

__all__ = ["doctor"]
