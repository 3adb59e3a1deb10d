import numpy as np
import pytest

from skindb.optics.fresnel import circular_reversal, fresnel_reflectance


@pytest.mark.parametrize("eta", [1.3, 1.45])
def test_circular_reversal__is_that_of_reflected_jones_vectors(eta):
    """Rationale: the amplitudes by Fresnel and Snell, applied to the fields along s and p."""
    angle = np.linspace(1e-3, np.pi / 2, 91)
    inside = np.arcsin(np.sin(angle) / eta)
    s = -np.sin(angle - inside) / np.sin(angle + inside)
    p = np.tan(angle - inside) / np.tan(angle + inside)
    right = np.array([1, 1j]) / np.sqrt(
        2
    )  # s and p, which with the direction are right-handed
    reflected = np.stack([s * right[0], p * right[1]])
    same = np.abs(right.conj() @ reflected) ** 2
    other = np.abs(right @ reflected) ** 2
    np.testing.assert_allclose(
        same + other, fresnel_reflectance(np.cos(angle), eta), atol=1e-12
    )
    np.testing.assert_allclose(
        circular_reversal(np.cos(angle), eta),
        (other - same) / (other + same),
        atol=1e-9,
    )
    brewster = np.cos(np.arctan(eta))
    assert circular_reversal([1.0, brewster, 0.0], eta) == pytest.approx([1, 0, -1])
