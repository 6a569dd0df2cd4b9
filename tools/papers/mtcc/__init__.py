"""Paper 3: cooperative control of five trains with position barriers."""
