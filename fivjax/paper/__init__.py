"""The paper's figures and tables, computed and compared with what it prints."""
