"""The run: its folder, its session, where it comes from, and loading what it trained."""
