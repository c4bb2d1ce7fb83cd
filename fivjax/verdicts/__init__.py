"""What can be proved of a motion by itself: it slides for ever, sticks for ever, or goes on sliding for a known time."""
