"""The paper: its figures and tables, beside what it prints."""
