"""Limit cycles and tori: closed, proved to attract, searched for, and who has been captured by them."""
