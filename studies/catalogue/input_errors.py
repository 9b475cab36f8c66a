"""Faults of the input: wrong labels, normals, poses and meshes, few photos, and objects of few sides."""

from studies.study import Claim, Scale, Setting, Study, full_matrix, project_claim

# ── label quality ─────────────────────────────────────────────────────────────────────────────────────────────────────

NORMALS = {"full": (1, 5, 10, 20), "quick": (5, 20)}
LABELS = {"full": (2, 20), "quick": (20,)}


def label_quality_settings(scale: Scale) -> list[Setting]:
    """Return the unperturbed setting, then one for each perturbation by itself."""
    return [
        scale.setting(f"{scale.side}x{scale.side}", "none"),
        *(scale.setting(f"normals-{d}deg", f"{d}°", normal_deg=float(d)) for d in NORMALS[scale.name]),
        *(scale.setting(f"labels-{p}pc", f"{p} %", wrong_labels=p / 100) for p in LABELS[scale.name]),
    ]


LATE = ("rise", "normals-10deg", "normals-20deg", 10)
EARLY = ("rise", "normals-5deg", "normals-10deg", 5)
LABEL_QUALITY = Study(
    name="label-quality",
    title="Label quality",
    question="How much do wrong normals and wrong labels cost?",
    paper="Noise of about 1 % on normals does not matter; with more the error rises, and then saturates.",
    varied="noise on normals (σ, degrees), or share of wrong labels (%)",
    measures=("entries", "new_light", "diffuse", "specular", "roughness", "glossy", "stated_roughness"),
    settings=label_quality_settings,
    claims=(
        project_claim("entries", "3x3", "normals-1deg", "noise of 1° on normals raises the error"),
        Claim("entries", "3x3", "normals-20deg", "noise of 20° on normals raises the error"),
        project_claim("entries", "normals-10deg", "normals-20deg", "20° is worse than 10°"),
        Claim("entries", LATE, EARLY, "the error rises less per degree beyond 10°"),
        project_claim("entries", "3x3", "labels-2pc", "2 % of wrong labels raise the error"),
        project_claim("entries", "3x3", "labels-20pc", "20 % of wrong labels raise the error"),
    ),
)


# ── alignment error ───────────────────────────────────────────────────────────────────────────────────────────────────

PERTURBED = {  # label, fields of `Objects`, treatments
    "exact": ("exact", {}, ()),
    "turned-2": ("turned 2°", {"turned_deg": 2.0}, ()),
    "turned-5": ("turned 5°", {"turned_deg": 5.0}, ("outline",)),
    "turned-20": ("turned 20°", {"turned_deg": 20.0}, ("outline",)),
    "shifted": ("shifted 5 %", {"shifted": 0.05}, ("outline",)),
    "larger": ("10 % larger", {"larger": 0.1}, ("outline",)),
    "coarse": ("of 100 triangles", {"triangles": 100}, ()),
}
TREATMENTS = {"outline": {"refined": True}}
ALIGNMENT_ERROR_QUICK = ("exact", "turned-5", "turned-20")


def alignment_error_settings(scale: Scale) -> list[Setting]:
    """Return a setting for each perturbation, with its treatments beside it."""
    entries = full_matrix(scale.side, scale.side)
    settings = []
    for name in ALIGNMENT_ERROR_QUICK if scale.quick else PERTURBED:
        label, fields, treatments = PERTURBED[name]
        settings.append(scale.object_setting(name, label, entries, **fields))
        for t in treatments:
            settings.append(scale.object_setting(f"{name}-{t}", f"{label} {t}", entries, **fields, **TREATMENTS[t]))
    return settings


COSTLY = ("turned-5", "turned-20", "shifted", "larger", "coarse")
ALIGNMENT_ERROR = Study(
    name="alignment-error",
    title="Alignment error",
    question="How much do wrong poses and meshes cost, and what helps?",
    paper="Poses off by up to 20°, shifts, wrong scales and coarse meshes raise the error. "
    "(How much is not taken over from the paper.)",
    varied="what is wrong with every object, and what is done",
    measures=("entries", "new_light", "normals", "diffuse", "specular", "roughness", "glossy"),
    settings=alignment_error_settings,
    claims=(
        *(Claim("entries", "exact", p, f"“{PERTURBED[p][0]}” raises the error") for p in COSTLY),
        *(
            project_claim(
                "entries", f"{p}-outline", p, f"fitting the outline helps where objects are {PERTURBED[p][0]}"
            )
            for p in ("turned-5", "turned-20", "larger")
        ),
    ),
    lights=1,
)


# ── progressive ───────────────────────────────────────────────────────────────────────────────────────────────────────


def progressive_settings(scale: Scale) -> list[Setting]:
    """Return settings of more and more photos."""
    numbers = range(1, scale.largest + 1)
    return [scale.object_setting(f"photos-{k}", str(k), full_matrix(scale.side, k)) for k in numbers]


PROGRESSIVE = Study(
    name="progressive",
    title="Progressive",
    question="Does each further photo of the same materials improve re-rendering, material and light?",
    paper="Each further photo improves re-rendering, the materials and the lights.",
    varied="photos of the same materials",
    measures=("new_light", "first_light", "seconds", "diffuse", "specular", "roughness", "glossy"),
    settings=progressive_settings,
    claims=(
        Claim("new_light", "photos-5", "photos-1", "5 photos are better than one (re-rendering)"),
        Claim("diffuse", "photos-5", "photos-1", "5 photos are better than one (k_d)"),
        Claim("roughness", "photos-5", "photos-1", "5 photos are better than one (roughness)"),
        Claim("first_light", "photos-5", "photos-1", "5 photos are better than one (light 0)"),
        project_claim("new_light", "photos-5", "photos-4", "the last of 5 photos still improves re-rendering"),
    ),
    lights=1,
)


# ── gauss sphere ──────────────────────────────────────────────────────────────────────────────────────────────────────

FACES = {"full": (1, 3, 9, 60), "quick": (1, 9)}
GUESS = ("guess", "faces-9")


def gauss_sphere_settings(scale: Scale) -> list[Setting]:
    """Return settings from one face to a sphere."""
    few = [scale.setting(f"faces-{k}", str(k), facets=k) for k in FACES[scale.name]]
    return [*few, scale.setting(f"{scale.side}x{scale.side}", "sphere")]


GAUSS_SPHERE = Study(
    name="gauss-sphere",
    title="Gauss-sphere coverage",
    question="What do flat-sided objects tell, and does the solve know?",
    paper="Objects with flat sides, which cover little of the Gauss sphere, can still be reconstructed.",
    varied="faces that an object shows",
    measures=("new_light", "entries", "roughness", "stated_roughness", "diffuse", "specular", "stated_reflectance"),
    settings=gauss_sphere_settings,
    claims=(
        Claim(
            "new_light",
            "faces-9",
            GUESS,
            "materials of nine faces are predicted in every light better than by a guess of mean colours",
        ),
        Claim(
            "entries",
            "faces-9",
            GUESS,
            "all entries are predicted from nine faces better than by a guess of mean colours",
        ),
        Claim("new_light", "faces-9", "faces-1", "nine faces tell more of materials than one"),
        project_claim("new_light", "3x3", "faces-9", "a sphere tells more than nine faces"),
        project_claim("roughness", "3x3", "faces-1", "roughness is known better of a sphere than of one face"),
        project_claim(
            "stated_roughness",
            "3x3",
            "faces-1",
            "the solve states a smaller error of roughness for a sphere than for one face",
        ),
    ),
)
