"""Conformance: rules that anyone can hold their own sampler to, see docs/conformance.md.

`leco check NAME` prints them, `pytest --pyargs leco_plugin.conformance --leco-sampler NAME` tests
them. Nothing is imported here, because pytest loads `pytest_plugin` in every run on a machine.
"""
