"""Proofs that need no hardware: the paper's experiment run again, and the methods that it names beside this station's.

Recordings are made from the physics of the twins, so the truth is known. ``station study`` prints the results.
"""
