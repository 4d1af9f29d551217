"""Classifies sweeps: network, novelty detection and early exit; enrols new materials."""
