"""Code that several recipes share: settings, command line, error messages, and parallel runs."""
