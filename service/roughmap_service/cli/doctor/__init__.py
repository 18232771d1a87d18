"""`roughmap doctor`: what stands in the way of mapping, in plain words."""

from roughmap_service.cli.doctor.command import doctor

__all__ = ["doctor"]
