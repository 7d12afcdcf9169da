"""What a run says at its end: tables and pictures."""
