"""The rules of a run: what each logged message does to it. No network, no disk, no clock."""
