"""What a campaign may claim: intervals, paired comparisons, sample sizes. Knows no flights."""
