"""Datasets and files: results with units and provenance, recordings."""
