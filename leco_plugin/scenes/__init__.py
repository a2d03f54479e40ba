"""Scenes with known truth: a procedural city, its pictures and its exact geometry."""
