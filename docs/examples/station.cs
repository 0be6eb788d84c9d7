// A capture station in C#: every scan that the scanner saves is sent, checked, and judged in a line.
//
//     csc station.cs -r:System.Net.Http.dll -r:System.Runtime.Serialization.dll -r:System.Xml.Linq.dll
//     set MYOFACE_API_KEY=myo_...
//     station.exe C:\scans https://faces.example.com
//
// It needs nothing but what Windows has: its own compiler (C# 5, in Microsoft.NET\Framework64\v4.0.30319)
// makes it, and so does .NET 8. Each folder in C:\scans is a person, each OBJ, PLY, GLB or STL in it a raw
// scan, named like its file; one with neutral or rest as a word of its name is the neutral. Scan again
// into the same file, and the new one takes the old one's place. With --once it looks once, and ends.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Net.Http;
using System.Net.Http.Headers;
using System.Runtime.Serialization.Json;
using System.Security.Cryptography;
using System.Text;
using System.Text.RegularExpressions;
using System.Threading;
using System.Xml;
using System.Xml.Linq;

static class Station {
    static readonly HttpClient Http = new HttpClient { Timeout = TimeSpan.FromMinutes(10) };
    static readonly Dictionary<string, DateTime> Done = new Dictionary<string, DateTime>();

    static void Main(string[] given) {
        Http.BaseAddress = new Uri(given.Length > 1 ? given[1] : "http://127.0.0.1:8765");
        var key = Environment.GetEnvironmentVariable("MYOFACE_API_KEY");
        Http.DefaultRequestHeaders.Authorization = new AuthenticationHeaderValue("Bearer", key);
        do {
            foreach (var path in Directory.GetFiles(given[0], "*.*", SearchOption.AllDirectories).Where(IsScan).OrderBy(p => !IsNeutral(p))) {
                var saved = File.GetLastWriteTimeUtc(path);
                if (Done.ContainsKey(path) && Done[path] == saved || DateTime.UtcNow - saved < TimeSpan.FromSeconds(2)) continue;
                try { DealWith(path); }
                catch (Refusal refusal) { Console.WriteLine("{0}: refused: {1}", path, refusal.Message); }
                catch (Exception fault) { Console.WriteLine("{0}: waits: {1}", path, fault.GetBaseException().Message); continue; }
                Done[path] = saved;
            }
            Thread.Sleep(1000);
        } while (!given.Contains("--once"));
    }

    static void DealWith(string path) {
        var name = NameOf(path);
        var sha256 = BitConverter.ToString(SHA256.Create().ComputeHash(File.ReadAllBytes(path))).Replace("-", "").ToLower();
        var captures = "/v1/subjects/" + SubjectOf(Path.GetDirectoryName(path)) + "/captures";
        var known = Ask("GET", captures + "?limit=1000").Element("items").Elements().FirstOrDefault(each => each.Element("name").Value == name);
        if (known == null || known.Element("sha256").Value != sha256)
            known = Ask("POST", captures, Json("name", name, "role", IsNeutral(path) ? "neutral" : "expression",
                "upload_id", Upload(path, sha256), "replaces", known == null ? null : known.Element("id").Value));
        var url = "/v1/jobs/" + Guid.NewGuid(); // our own id: sent twice, it is still one job
        var check = Ask("PUT", url, "{\"kind\":\"check_scan\",\"subject_id\":" + Quote(known.Element("subject_id").Value)
            + ",\"captures\":[" + Quote(known.Element("id").Value) + "]}");
        while (!new[] { "succeeded", "failed", "canceled" }.Contains(check.Element("state").Value)) {
            Thread.Sleep(500);
            check = Ask("GET", url);
        }
        if (check.Element("state").Value != "succeeded") throw new Refusal("the check has " + check.Element("state").Value);
        var found = check.Element("result").Element("summary");
        Console.WriteLine("{0}: {1}", path, found.Element("verdict").Value);
        foreach (var finding in found.Element("findings").Elements())
            Console.WriteLine("    {0}: {1}", finding.Element("message").Value, finding.Element("advice").Value);
    }

    // Sends a file; where the line breaks, it goes on with what the service lacks.
    static string Upload(string path, string sha256) {
        var size = new FileInfo(path).Length;
        var start = new HttpRequestMessage(HttpMethod.Post, "/v1/uploads");
        start.Headers.Add("Upload-Length", size.ToString());
        start.Headers.Add("Upload-Metadata", "filename " + Base64(Path.GetFileName(path)) + ",sha256 " + Base64(sha256));
        var id = Send(start).Element("id").Value;
        for (long offset = 0, tries = 0; offset < size || tries == 0; tries++) {
            try {
                using (var stream = File.OpenRead(path)) {
                    stream.Seek(offset, SeekOrigin.Begin);
                    var part = new HttpRequestMessage(new HttpMethod("PATCH"), "/v1/uploads/" + id) { Content = new StreamContent(stream) };
                    part.Headers.Add("Upload-Offset", offset.ToString());
                    part.Content.Headers.ContentType = new MediaTypeHeaderValue("application/offset+octet-stream");
                    Send(part);
                }
            } catch (HttpRequestException) { if (tries > 20) throw; Thread.Sleep(2000); }
            offset = long.Parse(Ask("GET", "/v1/uploads/" + id).Element("offset").Value);
        }
        return id;
    }

    static string SubjectOf(string folder) {
        var note = Path.Combine(folder, ".myoface-subject");
        if (!File.Exists(note)) File.WriteAllText(note, Ask("POST", "/v1/subjects", Json("name", Path.GetFileName(folder))).Element("id").Value);
        return File.ReadAllText(note).Trim();
    }

    static bool IsScan(string path) { return Regex.IsMatch(path, @"\.(obj|ply|glb|stl)$", RegexOptions.IgnoreCase); }

    static bool IsNeutral(string path) { return Regex.IsMatch(Path.GetFileNameWithoutExtension(path), "(?<![A-Za-z])(neutral|neutre|rest|relaxed)(?![A-Za-z])", RegexOptions.IgnoreCase); }

    // A legal name: accents go, what is no letter, digit, _, - or . becomes _, and 64 characters stay.
    static string NameOf(string path) {
        var plain = Regex.Replace(Path.GetFileNameWithoutExtension(path).Normalize(NormalizationForm.FormD), @"\p{Mn}", "");
        var name = Regex.Replace(Regex.Replace(plain, "[^A-Za-z0-9_.-]+", "_"), "^[^A-Za-z0-9]+|[^A-Za-z0-9]+$", "");
        if (name == "") throw new Refusal("no name can be made of it: a letter of a to z or a digit is needed");
        return name.Substring(0, Math.Min(64, name.Length));
    }

    static XElement Ask(string method, string path, string body = null) {
        var request = new HttpRequestMessage(new HttpMethod(method), path);
        if (body != null) request.Content = new StringContent(body, Encoding.UTF8, "application/json");
        return Send(request);
    }

    // Returns the answer's JSON as elements; what the service refuses, but for "later", is a Refusal.
    static XElement Send(HttpRequestMessage request) {
        var answer = Http.SendAsync(request).GetAwaiter().GetResult();
        var text = answer.Content.ReadAsByteArrayAsync().GetAwaiter().GetResult();
        if (answer.IsSuccessStatusCode && text.Length == 0) return null;
        if (text.Length == 0 || text[0] != '{') throw new HttpRequestException("the service answered " + (int)answer.StatusCode);
        var json = XElement.Load(JsonReaderWriterFactory.CreateJsonReader(text, XmlDictionaryReaderQuotas.Max));
        if (answer.IsSuccessStatusCode) return json;
        var isForGood = new[] { 404, 410, 413, 422 }.Contains((int)answer.StatusCode);
        if (isForGood) throw new Refusal(json.Element("detail").Value);
        throw new HttpRequestException(json.Element("detail").Value);
    }

    static string Json(params string[] pairs) {
        var members = Enumerable.Range(0, pairs.Length / 2).Where(i => pairs[2 * i + 1] != null);
        return "{" + string.Join(",", members.Select(i => Quote(pairs[2 * i]) + ":" + Quote(pairs[2 * i + 1]))) + "}";
    }

    static string Quote(string text) {
        var plain = text.Select(c => c < ' ' || c > '~' || c == '"' || c == '\\' ? "\\u" + ((int)c).ToString("x4", CultureInfo.InvariantCulture) : c.ToString());
        return '"' + string.Concat(plain) + '"';
    }

    static string Base64(string text) { return Convert.ToBase64String(Encoding.UTF8.GetBytes(text)); }

    class Refusal : Exception { public Refusal(string words) : base(words) { } }
}
