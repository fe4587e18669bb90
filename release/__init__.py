"""What a release of ZenFI is made of and what it needs: dependencies, bill of materials, vulnerabilities."""
