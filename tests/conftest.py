"""Stands here so that the helpers beside it (`net`) can be imported from every folder of tests."""
