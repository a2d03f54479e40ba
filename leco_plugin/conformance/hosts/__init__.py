"""The rules for guided hosts."""
