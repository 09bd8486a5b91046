"""Every story under every strategy: does switching ever do worse than one module alone?"""
