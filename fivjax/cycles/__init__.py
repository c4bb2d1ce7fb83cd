"""Limit cycles and saddle cycles of one scene: searched for, described, and next to known ones."""
