"""What several recipes share: settings, the command line, and many runs at a time."""
