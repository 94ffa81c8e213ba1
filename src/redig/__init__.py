"""ReDiG."""
