"""Recordings as others make them, simulated by code of its own or real with a fault planted, and their truth."""
